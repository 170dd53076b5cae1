// Run an exported policy with ONNX Runtime's C++ API: a line of numbers in is an observation, a line out is an action.
//
//   g++ -std=c++17 robot_loop.cpp -I$ONNXRUNTIME_ROOT/include -L$ONNXRUNTIME_ROOT/lib -lonnxruntime -o robot_loop
//   ./robot_loop policy.onnx [horizon] < observations.txt
//
// For observations of floats and actions of floats. An empty line begins an episode.

#include <onnxruntime_cxx_api.h>

#include <algorithm>
#include <cstdint>
#include <iostream>
#include <random>
#include <sstream>
#include <string>
#include <vector>

int main(int argc, char** argv) {
    if (argc < 2) {
        std::cerr << "give the file of a policy" << std::endl;
        return 2;
    }
    const std::int64_t horizon = argc > 2 ? std::stoll(argv[2]) : INT64_MAX;
    Ort::Env env(ORT_LOGGING_LEVEL_WARNING, "robot_loop");
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);  // a step is too small to share
    Ort::Session session(env, argv[1], options);
    Ort::AllocatorWithDefaultOptions allocator;
    const auto memory_info = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

    // Every input but the time step is a tensor of floats, (1, ...).
    std::vector<std::string> names;
    std::vector<std::vector<std::int64_t>> shapes;
    std::vector<std::vector<float>> buffers;
    for (std::size_t i = 0; i < session.GetInputCount(); ++i) {
        names.emplace_back(session.GetInputNameAllocated(i, allocator).get());
        auto shape = session.GetInputTypeInfo(i).GetTensorTypeAndShapeInfo().GetShape();
        shape[0] = 1;
        std::size_t size = 1;
        for (const auto side : shape) size *= static_cast<std::size_t>(side);
        shapes.push_back(shape);
        buffers.emplace_back(size, 0.0f);
    }
    std::vector<const char*> input_names;
    for (const auto& name : names) input_names.push_back(name.c_str());
    const char* output_names[] = {"action", "next_memory"};

    std::mt19937 generator(std::random_device{}());
    std::normal_distribution<float> normal;
    std::int64_t t = 0;
    for (std::string line; std::getline(std::cin, line);) {
        if (line.empty() || t >= horizon) {
            t = 0;
            for (auto& buffer : buffers) std::fill(buffer.begin(), buffer.end(), 0.0f);
            if (line.empty()) continue;
        }
        std::vector<Ort::Value> inputs;
        for (std::size_t i = 0; i < names.size(); ++i) {
            const auto& name = names[i];
            const auto& shape = shapes[i];
            auto& buffer = buffers[i];
            if (name == "time_step") {
                inputs.push_back(Ort::Value::CreateTensor<std::int64_t>(memory_info, &t, 1, shape.data(), shape.size()));
                continue;
            }
            if (name == "observation") {
                std::istringstream numbers(line);
                for (auto& number : buffer) numbers >> number;
            } else if (name != "memory") {
                for (auto& number : buffer) number = normal(generator);  // zeros: the deterministic policy
            }
            inputs.push_back(Ort::Value::CreateTensor<float>(memory_info, buffer.data(), buffer.size(), shape.data(), shape.size()));
        }
        auto outputs = session.Run(Ort::RunOptions{nullptr}, input_names.data(), inputs.data(), inputs.size(), output_names, 2);
        const auto n_actions = outputs[0].GetTensorTypeAndShapeInfo().GetElementCount();
        const float* action = outputs[0].GetTensorData<float>();
        for (std::size_t i = 0; i < n_actions; ++i) std::cout << (i ? " " : "") << action[i];
        std::cout << std::endl;
        for (std::size_t i = 0; i < names.size(); ++i) {
            if (names[i] == "memory") {
                const float* next = outputs[1].GetTensorData<float>();
                buffers[i].assign(next, next + buffers[i].size());
            }
        }
        ++t;
    }
}
