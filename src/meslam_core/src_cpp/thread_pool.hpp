// A few persistent threads that sleep until there is work.
#pragma once

#include <sys/types.h>

#include <condition_variable>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace meslam {

// Waiting is on a condition variable, never by spinning: the cores are shared with the pipeline's
// other workers, and a spinning barrier would take from them what it waits for.
class ThreadPool {
public:
    explicit ThreadPool(int threads) : threads_(threads) {}
    ~ThreadPool();
    ThreadPool(const ThreadPool&) = delete;
    ThreadPool& operator=(const ThreadPool&) = delete;

    int threads() const { return threads_; }

    // Calls task(0) on the calling thread and task(1) to task(threads - 1) on the others, and
    // returns when all are done. Not to be called from two threads at once.
    void run(const std::function<void(int)>& task);

private:
    void start_workers();
    void work(int index, unsigned long seen);

    const int threads_;
    pid_t owner_ = -1;
    std::vector<std::thread> workers_;
    std::mutex mutex_;
    std::condition_variable work_ready_;
    std::condition_variable work_done_;
    const std::function<void(int)>* task_ = nullptr;
    unsigned long generation_ = 0;
    int unfinished_ = 0;
    bool stopping_ = false;
};

}  // namespace meslam
